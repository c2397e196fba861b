// The port with its one client, the thread that watches the heartbeat, and the loop of the application.
package orthocapture.sunrise;

import java.io.IOException;
import java.net.InetAddress;
import java.net.ServerSocket;
import java.net.Socket;
import java.util.concurrent.ArrayBlockingQueue;
import java.util.concurrent.BlockingQueue;
import java.util.concurrent.TimeUnit;

public final class Server implements Connection.Owner {
    public static final int PORT = 30010;
    private static final long PERIOD_NS = 10000000L;
    private static final long WATCH_MS = 5;
    private static final long HANG_UP_MS = 500;
    private static final double GIVES_WAY_S = 5.0;

    /** What happened at a connection, for the loop. */
    private static final class News {
        final Connection connection;
        final String line;
        final boolean begins;

        News(Connection connection, String line, boolean begins) {
            this.connection = connection;
            this.line = line;
            this.begins = begins;
        }
    }

    private final Engine engine;
    private final Log log;
    private final ServerSocket listener;
    private final BlockingQueue<News> news = new ArrayBlockingQueue<News>(1000);
    private volatile Connection client;
    private volatile boolean running = true;

    /** Listens on an address of the controller; null: on all. `fri` is null where FRI is not installed. */
    public Server(Arm arm, Fri fri, InetAddress address, int port, Log log) throws IOException {
        this(arm, fri, address, port, log, Engine.HEARTBEAT_S);
    }

    /** For a simulated arm on a machine that has other work too, which is no dead client. */
    public Server(Arm arm, Fri fri, InetAddress address, int port, Log log, double heartbeatS) throws IOException {
        this.engine = new Engine(arm, fri, log, heartbeatS, System.nanoTime());
        this.log = log;
        this.listener = new ServerSocket(port, 4, address);
    }

    /** Serves until `stop`; the calling thread becomes the application's. */
    public void run() throws InterruptedException {
        Connection.start("listener", new Runnable() {
            @Override
            public void run() {
                accept();
            }
        });
        Connection.start("heartbeat", new Runnable() {
            @Override
            public void run() {
                watch();
            }
        });
        log.info("waiting for orthocapture on port " + listener.getLocalPort());
        long nextNs = System.nanoTime();
        try {
            while (running) {
                News one = news.poll(Math.max(0, nextNs - System.nanoTime()), TimeUnit.NANOSECONDS);
                if (one != null) {
                    take(one);
                }
                long nowNs = System.nanoTime();
                if (nowNs >= nextNs) {
                    engine.tick(nowNs);
                    nextNs = Math.max(nextNs + PERIOD_NS, nowNs);
                }
            }
        } finally {
            stop();
        }
    }

    /** Stops the arm and closes the port; any thread. */
    public void stop() {
        running = false;
        engine.cutOff();
        try {
            listener.close();
        } catch (IOException e) {
            log.info("closing: " + e);
        }
        Connection connected = client;
        if (connected != null) {
            connected.close();
        }
    }

    @Override
    public void heard(Connection connection, String line) {
        if (connection == client) {
            engine.hear(System.nanoTime());
            put(new News(connection, line, false));
        }
    }

    @Override
    public void lost(Connection connection) {
        if (connection == client) {
            engine.cutOff();
            put(new News(connection, null, false));
        }
    }

    private void take(News one) {
        if (one.begins) {
            engine.connect(one.connection, System.nanoTime());
        } else if (one.line == null) {
            log.info("orthocapture has gone");
            engine.disconnect();
            client = null;
        } else if (one.connection.isOpen()) {
            engine.line(one.line);
        }
    }

    private void accept() {
        while (running) {
            try {
                Socket socket = listener.accept();
                Connection connection = new Connection(socket, this);
                if (isFree()) {
                    log.info("orthocapture connects from " + socket.getInetAddress().getHostAddress());
                    client = connection;
                    put(new News(connection, null, true));
                    connection.begin();
                } else {
                    String taken = Engine.refusal(null, "taken", "another client is connected") + "\n";
                    socket.getOutputStream().write(taken.getBytes("UTF-8"));
                    socket.close();
                }
            } catch (IOException e) {
                if (running) {
                    log.info("a connection failed: " + e);
                }
            }
        }
    }

    /** Waits a little for a client that hangs up just now, and ends one that is silent. */
    private boolean isFree() {
        long untilNs = System.nanoTime() + HANG_UP_MS * 1000000L;
        while (client != null && System.nanoTime() < untilNs) {
            Connection connected = client;
            if (connected != null && engine.silentS(System.nanoTime()) > GIVES_WAY_S) {
                connected.close();
            }
            pause(WATCH_MS);
        }
        return client == null;
    }

    private void watch() {
        while (running) {
            try {
                engine.watch(System.nanoTime());
            } catch (RuntimeException e) {
                log.info("the arm cannot be stopped: " + e);
            }
            pause(WATCH_MS);
        }
    }

    private void put(News one) {
        try {
            news.put(one);
        } catch (InterruptedException e) {
            Thread.currentThread().interrupt();
        }
    }

    private static void pause(long milliseconds) {
        try {
            Thread.sleep(milliseconds);
        } catch (InterruptedException e) {
            Thread.currentThread().interrupt();
        }
    }
}
