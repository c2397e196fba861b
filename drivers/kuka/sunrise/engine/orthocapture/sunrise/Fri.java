// A session of the Fast Robot Interface that only monitors: in FRI's terms, one without an overlay.
package orthocapture.sunrise;

public interface Fri {
    /** Sends monitor messages to a host. Throws RefusedException if the controller cannot. */
    void start(String host, int port, int periodMs) throws RefusedException;

    /** Ends the session, if there is one. */
    void end();
}
