// Runs the engine on the JVM with a simulated arm: its words are an address and the longest silence of a client in s.
package orthocapture.sunrise.simulated;

import java.io.BufferedReader;
import java.io.IOException;
import java.io.InputStreamReader;
import java.net.InetAddress;
import java.net.ServerSocket;
import java.net.Socket;
import orthocapture.sunrise.ArmState;
import orthocapture.sunrise.Log;
import orthocapture.sunrise.Server;

public final class Main {
    private Main() {
    }

    public static void main(String[] words) throws Exception {
        InetAddress host = InetAddress.getByName(words[0]);
        final SimulatedArm arm = new SimulatedArm();
        Log log = new Log() {
            @Override
            public void info(String text) {
                System.err.println(text);
            }
        };
        Server server = new Server(arm, null, host, Server.PORT, log, Double.parseDouble(words[1]));
        final ServerSocket pendant = new ServerSocket(Server.PORT + 1, 4, host);
        Thread thread = new Thread(new Runnable() {
            @Override
            public void run() {
                serve(pendant, arm);
            }
        });
        thread.setDaemon(true);
        thread.start();
        System.out.println("{\"application\":\"" + words[0] + ":" + Server.PORT + "\"}");
        System.out.flush();
        server.run();
    }

    /** A second port takes what a person does at the smartPAD. */
    private static void serve(ServerSocket pendant, SimulatedArm arm) {
        while (true) {
            try {
                Socket socket = pendant.accept();
                BufferedReader lines = new BufferedReader(new InputStreamReader(socket.getInputStream(), "UTF-8"));
                String line = lines.readLine();
                boolean done = line != null && press(line.split(" "), arm);
                socket.getOutputStream().write((done ? "ok\n" : "no\n").getBytes("UTF-8"));
                socket.close();
            } catch (IOException e) {
                System.err.println("pendant: " + e);
            }
        }
    }

    private static boolean press(String[] words, SimulatedArm arm) {
        if (words.length == 2 && words[0].equals("stop")) {
            arm.safety = words[1];
        } else if (words.length == 1 && words[0].equals("release")) {
            arm.safety = ArmState.NORMAL;
        } else if (words.length == 2 && words[0].equals("mode")) {
            arm.mode = words[1];
        } else if (words.length == 2 && words[0].equals("hang")) {
            arm.hangs = words[1].equals("on");
        } else {
            return false;
        }
        return true;
    }
}
