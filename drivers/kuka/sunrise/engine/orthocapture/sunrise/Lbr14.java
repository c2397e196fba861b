// What the LBR iiwa 14 R820 and the LBR Med 14 R820 have in common, apart from any version of Sunrise.OS.
package orthocapture.sunrise;

public final class Lbr14 {
    /** Largest load on the flange (data sheet of the LBR iiwa 14 R820). */
    public static final double RATED_LOAD_KG = 14.0;

    /** Largest speeds of the joints (data sheet of the LBR iiwa 14 R820). */
    private static final double[] FULL_SPEED_RAD_S = {
        Math.toRadians(85), Math.toRadians(85), Math.toRadians(100), Math.toRadians(75), Math.toRadians(130),
        Math.toRadians(135), Math.toRadians(135),
    };

    /**
     * KUKA does not publish the accelerations that its relative values refer to. This one is larger than any that was
     * reported, so that the arm accelerates less than it was asked to, not more.
     */
    private static final double FULL_ACCELERATION_RAD_S2 = 15.0;

    private static final double LEAST_RATIO = 0.01;

    private Lbr14() {
    }

    /** The model of the wire for the name of the arm on the controller, such as LBR_Med_14_R820_1. */
    public static String model(String deviceName) {
        String name = deviceName.toLowerCase();
        if (name.contains("med_14") || name.contains("med14")) {
            return "LBR Med 14";
        }
        if (name.contains("iiwa_14") || name.contains("iiwa14")) {
            return "LBR iiwa 14";
        }
        return deviceName;
    }

    /**
     * The relative speed (0 to 1) at which the joint that turns most moves at speedRadS.
     *
     * A relative speed r limits joint i to r times its own full speed, and a synchronised motion takes as long as its
     * slowest joint: max over i of |d_i| / (r full_i). That is |d_max| / speed for r = speed max(|d_i| / full_i) / |d_max|.
     */
    public static double speedRatio(double[] startRad, double[] goalRad, double speedRadS) {
        double longest = 0.0;
        double slowest = 0.0;
        for (int i = 0; i < goalRad.length; i++) {
            double way = Math.abs(goalRad[i] - startRad[i]);
            longest = Math.max(longest, way);
            slowest = Math.max(slowest, way / FULL_SPEED_RAD_S[i]);
        }
        return longest > 0.0 ? ratio(speedRadS * slowest / longest) : LEAST_RATIO;
    }

    /** The relative acceleration (0 to 1) for an acceleration of the joint that turns most. */
    public static double accelerationRatio(double accelerationRadS2) {
        return ratio(accelerationRadS2 / FULL_ACCELERATION_RAD_S2);
    }

    /**
     * The word of `safety` for the controller's own words, which are the names of its constants.
     *
     * @param stopSignal NOSTOP where the safety controller lets the arm move.
     * @param emergencyStops of the smartPAD and of the periphery: ACTIVE or INACTIVE.
     * @param operatorSafety OPERATOR_SAFETY_CLOSED where the safeguard is closed.
     * @param mode T1, T2, AUT or another.
     * @param enablingDevice NONE where nobody holds the enabling switch.
     */
    public static String safety(String stopSignal, String[] emergencyStops, String operatorSafety, String mode,
                                String enablingDevice) {
        if ("NOSTOP".equals(stopSignal)) {
            return ArmState.NORMAL;
        }
        for (String emergencyStop : emergencyStops) {
            if ("ACTIVE".equals(emergencyStop)) {
                return "emergency_stop";
            }
        }
        boolean automatic = "AUT".equals(mode);
        if (!automatic && "NONE".equals(enablingDevice)) {
            return "enabling_switch";
        }
        if (automatic && !"OPERATOR_SAFETY_CLOSED".equals(operatorSafety)) {
            return "external_stop";
        }
        return "protective_stop";
    }

    private static double ratio(double value) {
        return Math.max(LEAST_RATIO, Math.min(1.0, value));
    }
}
