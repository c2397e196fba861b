// Calls the engine's pure functions for the tests: a JSON list a line on the standard input, the answer on the output.
package orthocapture.sunrise.simulated;

import java.io.BufferedReader;
import java.io.InputStreamReader;
import java.util.List;
import orthocapture.sunrise.Json;
import orthocapture.sunrise.JsonException;
import orthocapture.sunrise.Lbr14;

public final class Probe {
    private Probe() {
    }

    public static void main(String[] words) throws Exception {
        BufferedReader lines = new BufferedReader(new InputStreamReader(System.in, "UTF-8"));
        for (String line = lines.readLine(); line != null; line = lines.readLine()) {
            String answer;
            try {
                answer = Json.write(call((List<?>) Json.parse(line)));
            } catch (JsonException e) {
                answer = "not JSON";
            }
            System.out.println(answer);
            System.out.flush();
        }
    }

    private static Object call(List<?> call) {
        Object name = call.get(0);
        if ("speed".equals(name)) {
            return Lbr14.speedRatio(numbers(call.get(1)), numbers(call.get(2)), ((Number) call.get(3)).doubleValue());
        }
        if ("acceleration".equals(name)) {
            return Lbr14.accelerationRatio(((Number) call.get(1)).doubleValue());
        }
        if ("model".equals(name)) {
            return Lbr14.model((String) call.get(1));
        }
        if ("safety".equals(name)) {
            String[] emergencyStops = {(String) call.get(2), (String) call.get(3)};
            return Lbr14.safety((String) call.get(1), emergencyStops, (String) call.get(4), (String) call.get(5),
                    (String) call.get(6));
        }
        return call;
    }

    private static double[] numbers(Object list) {
        double[] numbers = new double[((List<?>) list).size()];
        for (int i = 0; i < numbers.length; i++) {
            numbers[i] = ((Number) ((List<?>) list).get(i)).doubleValue();
        }
        return numbers;
    }
}
