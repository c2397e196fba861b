// One reading of the arm: joints, flange in the base frame, and what the controller says of itself.
package orthocapture.sunrise;

public final class ArmState {
    /** The word of `safety` in which the arm may move. */
    public static final String NORMAL = "normal";

    public final double[] jointsRad;
    public final double[] commandedRad;
    public final double[] flangeXyzM;
    public final double[] flangeAbcRad;
    public final String mode;
    public final String safety;
    public final boolean ready;
    public final double override;

    public ArmState(double[] jointsRad, double[] commandedRad, double[] flangeXyzM, double[] flangeAbcRad,
                    String mode, String safety, boolean ready, double override) {
        this.jointsRad = jointsRad;
        this.commandedRad = commandedRad;
        this.flangeXyzM = flangeXyzM;
        this.flangeAbcRad = flangeAbcRad;
        this.mode = mode;
        this.safety = safety;
        this.ready = ready;
        this.override = override;
    }
}
