// One client: a thread that reads its lines, and one that writes to it, so that neither can hold up the engine.
package orthocapture.sunrise;

import java.io.BufferedInputStream;
import java.io.IOException;
import java.io.InputStream;
import java.io.OutputStream;
import java.net.Socket;
import java.nio.charset.Charset;
import java.util.concurrent.BlockingQueue;
import java.util.concurrent.LinkedBlockingQueue;

final class Connection implements Engine.Client {
    static final int LONGEST_LINE = 65536;
    private static final int BACKLOG = 20;
    private static final int TOO_MANY = 2000;
    private static final Charset UTF_8 = Charset.forName("UTF-8");

    /** What the owner does with what the connection brings; called from the reading thread. */
    interface Owner {
        void heard(Connection connection, String line);

        void lost(Connection connection);
    }

    private final Socket socket;
    private final Owner owner;
    private final BlockingQueue<String> out = new LinkedBlockingQueue<String>();
    private volatile boolean open = true;

    Connection(Socket socket, Owner owner) throws IOException {
        this.socket = socket;
        this.owner = owner;
        socket.setTcpNoDelay(true);
        socket.setKeepAlive(true);
    }

    void begin() {
        start("reader", new Runnable() {
            @Override
            public void run() {
                read();
            }
        });
        start("writer", new Runnable() {
            @Override
            public void run() {
                write();
            }
        });
    }

    boolean isOpen() {
        return open;
    }

    @Override
    public void send(String line) {
        if (out.size() > TOO_MANY) {
            close();
        } else {
            out.add(line);
        }
    }

    @Override
    public void stream(String line) {
        if (out.size() < BACKLOG) {
            out.add(line);
        }
    }

    void close() {
        open = false;
        out.add("");
        try {
            socket.close();
        } catch (IOException e) {
            open = false;  // it is closed either way
        }
    }

    private void read() {
        try {
            InputStream in = new BufferedInputStream(socket.getInputStream());
            byte[] line = new byte[LONGEST_LINE];
            int length = 0;
            for (int next = in.read(); next >= 0; next = in.read()) {
                if (next != '\n') {
                    if (length < LONGEST_LINE) {
                        line[length] = (byte) next;
                    }
                    length++;
                    continue;
                }
                // A line that is too long becomes an empty one, which is refused.
                owner.heard(this, length > LONGEST_LINE ? "" : new String(line, 0, length, UTF_8));
                length = 0;
            }
        } catch (IOException e) {
            open = false;  // broken, which ends it like an orderly end
        } finally {
            close();
            owner.lost(this);
        }
    }

    private void write() {
        try {
            OutputStream stream = socket.getOutputStream();
            while (open) {
                stream.write((out.take() + "\n").getBytes(UTF_8));
                stream.flush();
            }
        } catch (IOException e) {
            close();
        } catch (InterruptedException e) {
            close();
        }
    }

    static void start(String name, Runnable work) {
        Thread thread = new Thread(work, "orthocapture " + name);
        thread.setDaemon(true);
        thread.start();
    }
}
