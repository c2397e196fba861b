// The motion under way: its number and goal, and why it is being ended early, if it is.
package orthocapture.sunrise;

final class Running {
    private static final double ARRIVED_RAD = 1e-3;
    private static final long LAG_NS = 200000000L;  // the commanded joints may be read a little late

    final long number;
    private final Motion motion;
    private final double[] goalRad;
    private String code = "";
    private String what = "";
    private boolean cancelled;
    private long overSinceNs;
    private double offRad;

    Running(long number, Motion motion, double[] goalRad) {
        this.number = number;
        this.motion = motion;
        this.goalRad = goalRad;
    }

    /** Ends the motion; the first reason counts. Any thread; throws what the controller throws. */
    synchronized void end(String code, String what) {
        if (this.code.length() == 0) {
            this.code = code;
            this.what = what;
        }
        insist();
    }

    /** Cancels again if the controller did not take it the first time. */
    synchronized void insist() {
        if (code.length() > 0 && !cancelled) {
            motion.cancel();
            cancelled = true;
        }
    }

    boolean isOver() {
        return motion.isOver();
    }

    /** Whether the commanded joints are at the goal, or have had time to get there; the arm does not move any more. */
    synchronized boolean isSettled(double[] commandedRad, long nowNs) {
        if (overSinceNs == 0) {
            overSinceNs = nowNs;
        }
        offRad = 0.0;
        for (int i = 0; i < goalRad.length; i++) {
            offRad = Math.max(offRad, Math.abs(goalRad[i] - commandedRad[i]));
        }
        return code.length() > 0 || offRad <= ARRIVED_RAD || nowNs - overSinceNs > LAG_NS;
    }

    /** The line that tells how the motion ended. */
    synchronized String outcome() {
        if (code.length() == 0 && motion.failure().length() > 0) {
            code = "failed";
            what = motion.failure();
        }
        if (code.length() == 0 && offRad > ARRIVED_RAD) {
            code = "failed";
            what = "the motion ended " + offRad + " rad from its goal";
        }
        if (code.length() == 0) {
            return Json.write(Json.object("is", "done", "motion", Long.valueOf(number)));
        }
        return Json.write(Json.object("is", "err", "seq", null, "motion", Long.valueOf(number), "code", code,
                "what", what));
    }
}
