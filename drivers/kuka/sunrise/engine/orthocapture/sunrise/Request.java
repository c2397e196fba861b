// One line of the client as an object with checked fields.
package orthocapture.sunrise;

import java.util.List;
import java.util.Map;

final class Request {
    final long sequence;
    final String verb;
    private final Map<?, ?> fields;

    private Request(long sequence, String verb, Map<?, ?> fields) {
        this.sequence = sequence;
        this.verb = verb;
        this.fields = fields;
    }

    /** Parses a line; null for a beat. Throws RefusedException with the code bad_line. */
    static Request of(String line) throws RefusedException {
        Object parsed;
        try {
            parsed = Json.parse(line);
        } catch (JsonException e) {
            throw new RefusedException("bad_line", "the line is not JSON: " + e.getMessage());
        }
        if (!(parsed instanceof Map)) {
            throw new RefusedException("bad_line", "the line is not a JSON object");
        }
        Map<?, ?> fields = (Map<?, ?>) parsed;
        String verb = String.valueOf(fields.get("do"));
        if ("beat".equals(verb)) {
            return null;
        }
        Object sequence = fields.get("seq");
        if (!(sequence instanceof Long)) {
            throw new RefusedException("bad_line", "seq is not an integer");
        }
        return new Request(((Long) sequence).longValue(), verb, fields);
    }

    String text(String name) throws RefusedException {
        Object value = fields.get(name);
        if (!(value instanceof String) || ((String) value).length() == 0) {
            throw wrong(name, "a text");
        }
        return (String) value;
    }

    double number(String name) throws RefusedException {
        return finite(fields.get(name), name, "a number");
    }

    double positive(String name) throws RefusedException {
        double value = number(name);
        if (value <= 0.0) {
            throw wrong(name, "above 0");
        }
        return value;
    }

    int whole(String name, int least, int most) throws RefusedException {
        Object value = fields.get(name);
        if (!(value instanceof Long) || ((Long) value).longValue() < least || ((Long) value).longValue() > most) {
            throw wrong(name, "a whole number from " + least + " to " + most);
        }
        return ((Long) value).intValue();
    }

    double[] numbers(String name, int count) throws RefusedException {
        String wanted = "a list of " + count + " numbers";
        Object value = fields.get(name);
        if (!(value instanceof List) || ((List<?>) value).size() != count) {
            throw wrong(name, wanted);
        }
        double[] numbers = new double[count];
        for (int i = 0; i < count; i++) {
            numbers[i] = finite(((List<?>) value).get(i), name, wanted);
        }
        return numbers;
    }

    private static double finite(Object value, String name, String wanted) throws RefusedException {
        double number = value instanceof Number ? ((Number) value).doubleValue() : Double.NaN;
        if (Double.isNaN(number) || Double.isInfinite(number)) {
            throw wrong(name, wanted);
        }
        return number;
    }

    private static RefusedException wrong(String name, String wanted) {
        return new RefusedException("bad_value", name + " is not " + wanted);
    }
}
