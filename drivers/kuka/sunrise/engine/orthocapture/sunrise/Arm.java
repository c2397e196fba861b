// All that the engine asks of a controller; one class for each version of Sunrise.OS, and one for the tests.
package orthocapture.sunrise;

public interface Arm {
    int JOINTS = 7;

    /** "LBR iiwa 14" or "LBR Med 14"; of another arm, its name on the controller. */
    String model();

    String serial();

    String software();

    /** The largest angles (7) of the joints, radians. */
    double[] upperLimitsRad();

    /** The smallest angles (7) of the joints, radians. */
    double[] lowerLimitsRad();

    /** The largest load on the flange, kilograms. */
    double ratedLoadKg();

    /** The arm now. Called every 10 ms from the thread of the application. */
    ArmState read();

    /** Sets the load, and returns what is in force. */
    Load attach(Load load);

    /**
     * Starts a joint motion and returns at once; the joint that turns most keeps to speed and acceleration.
     *
     * @throws RefusedException with the code not_ready or failed.
     */
    Motion move(double[] goalRad, double speedRadS, double accelerationRadS2) throws RefusedException;
}
