// A motion that the controller carries out.
package orthocapture.sunrise;

public interface Motion {
    /** Decelerates to a standstill; may be called from any thread, and more than once. */
    void cancel();

    /** Whether the arm stands again: arrived, cancelled or failed. */
    boolean isOver();

    /** Why the motion failed, in the controller's words; empty if it did not. */
    String failure();
}
