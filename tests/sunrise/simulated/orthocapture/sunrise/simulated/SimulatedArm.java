// An arm for the engine to move where there is no controller: joints in real time, stops, and a load.
package orthocapture.sunrise.simulated;

import java.util.concurrent.atomic.AtomicReference;
import orthocapture.sunrise.Arm;
import orthocapture.sunrise.ArmState;
import orthocapture.sunrise.Load;
import orthocapture.sunrise.Motion;
import orthocapture.sunrise.RefusedException;

final class SimulatedArm implements Arm {
    private static final double[] D_M = {0.360, 0.0, 0.420, 0.0, 0.400, 0.0, 0.126};
    private static final double[] ALPHA_DEG = {-90, 90, 90, -90, -90, 90, 0};
    private static final double[] LIMIT_DEG = {170, 120, 170, 120, 170, 120, 175};
    private static final double STOP_RAD_S2 = 6.0;

    /** What is set from outside. */
    volatile String mode = "AUT";
    volatile String safety = ArmState.NORMAL;
    volatile double override = 1.0;
    /** While true, a call to the controller does not return. */
    volatile boolean hangs;

    private final AtomicReference<Way> way = new AtomicReference<Way>();
    private double[] standsAt = {0.0, 0.5236, 0.0, -1.2217, 0.0, 1.3963, 0.0};

    @Override
    public String model() {
        return "LBR Med 14";
    }

    @Override
    public String serial() {
        return "a JVM";
    }

    @Override
    public String software() {
        return "no Sunrise.OS";
    }

    @Override
    public double[] upperLimitsRad() {
        double[] limits = new double[JOINTS];
        for (int i = 0; i < JOINTS; i++) {
            limits[i] = Math.toRadians(LIMIT_DEG[i]);
        }
        return limits;
    }

    @Override
    public double[] lowerLimitsRad() {
        double[] limits = upperLimitsRad();
        for (int i = 0; i < JOINTS; i++) {
            limits[i] = -limits[i];
        }
        return limits;
    }

    @Override
    public double ratedLoadKg() {
        return 14.0;
    }

    @Override
    public ArmState read() {
        while (hangs) {
            Thread.yield();
        }
        Way now = way.get();
        double[] joints = now == null ? standsAt : now.joints();
        double[][] pose = flange(joints);
        double[] abc = {
            Math.atan2(pose[1][0], pose[0][0]), Math.atan2(-pose[2][0], Math.hypot(pose[0][0], pose[1][0])),
            Math.atan2(pose[2][1], pose[2][2]),
        };
        double[] xyz = {pose[0][3], pose[1][3], pose[2][3]};
        return new ArmState(joints, joints, xyz, abc, mode, safety, true, override);
    }

    @Override
    public Load attach(Load load) {
        return load;
    }

    @Override
    public Motion move(double[] goalRad, double speedRadS, double accelerationRadS2) throws RefusedException {
        Way last = way.get();
        standsAt = last == null ? standsAt : last.joints();
        Way next = new Way(standsAt, goalRad, speedRadS, accelerationRadS2);
        way.set(next);
        return next;
    }

    private static double[][] flange(double[] joints) {
        double[][] T = {{1, 0, 0, 0}, {0, 1, 0, 0}, {0, 0, 1, 0}, {0, 0, 0, 1}};
        for (int i = 0; i < JOINTS; i++) {
            double c = Math.cos(joints[i]);
            double s = Math.sin(joints[i]);
            double ca = Math.cos(Math.toRadians(ALPHA_DEG[i]));
            double sa = Math.sin(Math.toRadians(ALPHA_DEG[i]));
            double[][] link = {{c, -s * ca, s * sa, 0}, {s, c * ca, -c * sa, 0}, {0, sa, ca, D_M[i]}, {0, 0, 0, 1}};
            double[][] product = new double[4][4];
            for (int row = 0; row < 4; row++) {
                for (int column = 0; column < 4; column++) {
                    for (int k = 0; k < 4; k++) {
                        product[row][column] += T[row][k] * link[k][column];
                    }
                }
            }
            T = product;
        }
        return T;
    }

    /** A trapezoid along the straight line between two postures, advanced whenever somebody looks. */
    private static final class Way implements Motion {
        private final double[] start;
        private final double[] goal;
        private final double speed;
        private final double acceleration;
        private double length;
        private double at;
        private double v;
        private boolean cancelled;
        private long lookedNs = System.nanoTime();

        Way(double[] start, double[] goal, double speed, double acceleration) {
            this.start = start;
            this.goal = goal;
            this.speed = speed;
            this.acceleration = acceleration;
            for (int i = 0; i < JOINTS; i++) {
                length = Math.max(length, Math.abs(goal[i] - start[i]));
            }
        }

        @Override
        public synchronized void cancel() {
            advance();
            cancelled = true;
        }

        @Override
        public synchronized boolean isOver() {
            advance();
            return at >= length || (cancelled && v <= 0.0);
        }

        @Override
        public String failure() {
            return "";
        }

        synchronized double[] joints() {
            advance();
            double[] joints = new double[JOINTS];
            for (int i = 0; i < JOINTS; i++) {
                joints[i] = start[i] + (length > 0.0 ? at / length : 1.0) * (goal[i] - start[i]);
            }
            return joints;
        }

        private void advance() {
            long nowNs = System.nanoTime();
            for (double dt = 0.001; lookedNs + 1000000L <= nowNs; lookedNs += 1000000L) {
                if (cancelled) {
                    v = Math.max(0.0, v - STOP_RAD_S2 * dt);
                } else {
                    double braking = Math.sqrt(2.0 * acceleration * Math.max(0.0, length - at));
                    v = Math.min(Math.min(speed, braking), v + acceleration * dt);
                }
                at = Math.min(length, at + v * dt);
                if (!cancelled && length - at < 1e-5) {
                    at = length;
                }
            }
        }
    }
}
