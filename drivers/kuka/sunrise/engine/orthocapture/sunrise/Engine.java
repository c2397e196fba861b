// The protocol of docs/reference/kuka_protocol.md without sockets: requests, the stream, the latch, the heartbeat, ends of motions.
package orthocapture.sunrise;

import java.util.LinkedHashMap;
import java.util.Map;

/**
 * `connect`, `line`, `tick` and `disconnect` belong to one thread, the application's, which alone asks the controller to
 * move. `hear`, `watch` and `cutOff` may be called from others and never wait for it: they stop the arm even when a call
 * to the controller does not return.
 */
public final class Engine {
    public static final int PROTOCOL = 1;
    public static final double HEARTBEAT_S = 0.3;
    /** After a pause of the whole machine, what the client sent meanwhile is still to be read. */
    private static final long PAUSE_NS = 100000000L;

    /** The other end of the connection; neither call waits for it. */
    public interface Client {
        /** Sends a line that must arrive. */
        void send(String line);

        /** Sends a line of the stream, which is left out while the client does not read. */
        void stream(String line);
    }

    private final Arm arm;
    private final Fri fri;
    private final Log log;
    private final double heartbeatS;
    private final long startNs;
    private volatile boolean locked = true;
    private volatile long heardNs;
    private volatile Running running;
    private long watchedNs;
    private long patientUntilNs;
    private Client client;
    private ArmState state;
    private long lines;
    private long motions;
    private String trouble = "";

    /** `fri` is null where FRI is not installed; the arm is stopped `heartbeatS` after its client's last line. */
    public Engine(Arm arm, Fri fri, Log log, double heartbeatS, long nowNs) {
        this.heartbeatS = heartbeatS;
        this.arm = arm;
        this.fri = fri;
        this.log = log;
        this.startNs = nowNs;
        this.heardNs = nowNs;
        this.watchedNs = nowNs;
        this.patientUntilNs = nowNs;
    }

    // --- any thread -------------------------------------------------------------------------------------------

    /** Notes that a line of the client arrived. */
    public void hear(long nowNs) {
        heardNs = nowNs;
    }

    /** How long no line has come, in seconds. */
    public double silentS(long nowNs) {
        return (nowNs - heardNs) / 1e9;
    }

    /** Stops a moving arm whose client is silent; called every few milliseconds by a thread of its own. */
    public void watch(long nowNs) {
        if (nowNs - watchedNs > PAUSE_NS) {
            patientUntilNs = nowNs + PAUSE_NS;
        }
        watchedNs = nowNs;
        Running motion = running;
        if (motion != null && nowNs > patientUntilNs && silentS(nowNs) > heartbeatS) {
            locked = true;
            motion.end("heartbeat", "the arm was stopped: no line of its client for " + heartbeatS + " s");
        }
    }

    /** The connection broke: stops the arm. `disconnect` follows. */
    public void cutOff() {
        locked = true;
        Running motion = running;
        if (motion != null) {
            try {
                motion.end("stopped", "the connection ended");
            } catch (RuntimeException e) {
                log.info("the arm cannot be stopped: " + e);  // `tick` tries again
            }
        }
    }

    // --- the application's thread -----------------------------------------------------------------------------

    /** A client has connected: the arm is locked, and the client is greeted. */
    public void connect(Client connected, long nowNs) {
        locked = true;
        client = connected;
        lines = 0;
        hear(nowNs);
        client.send(Json.write(Json.object(
                "is", "hello", "protocol", Long.valueOf(PROTOCOL), "model", arm.model(), "serial", arm.serial(),
                "software", arm.software(), "time_s", Double.valueOf(timeS(nowNs)))));
        tick(nowNs);
    }

    /** The client has gone. */
    public void disconnect() {
        cutOff();
        client = null;
        if (fri != null) {
            try {
                fri.end();
            } catch (RuntimeException e) {
                log.info("ending FRI: " + e);
            }
        }
    }

    /** Carries out a line of the client, and answers it. */
    public void line(String text) {
        Long sequence = null;
        try {
            Request request = Request.of(text);
            if (request == null) {
                return;
            }
            sequence = Long.valueOf(request.sequence);
            Map<String, Object> answer = Json.object("is", "ack", "seq", sequence);
            answer.putAll(carryOut(request));
            client.send(Json.write(answer));
        } catch (RefusedException e) {
            client.send(refusal(sequence, e.code, e.getMessage()));
        } catch (RuntimeException e) {
            log.info(text + ": " + e);
            client.send(refusal(sequence, "failed", String.valueOf(e)));
        }
    }

    /** Looks at the arm: the latch of stops, one line of the stream, the end of a motion. Every 10 ms. */
    public void tick(long nowNs) {
        try {
            Running motion = running;
            boolean over = motion != null && motion.isOver();  // before the state is read, which then shows it standing
            state = arm.read();
            if (!ArmState.NORMAL.equals(state.safety)) {
                locked = true;
                if (motion != null) {
                    motion.end("safety", "the arm is in " + state.safety.replace('_', ' '));
                }
            }
            if (motion != null) {
                motion.insist();
            }
            if (client != null) {
                client.stream(Json.write(stateLine(motion, nowNs)));
            }
            if (over && motion.isSettled(state.commandedRad, nowNs)) {
                running = null;
                String outcome = motion.outcome();
                log.info(outcome);
                if (client != null) {
                    client.send(outcome);
                }
            }
            trouble = "";
        } catch (RuntimeException e) {
            blind(e);
        }
    }

    /** The line that refuses a request; sequence is null where the line had none. */
    static String refusal(Long sequence, String code, String what) {
        return Json.write(Json.object("is", "err", "seq", sequence, "motion", null, "code", code, "what", what));
    }

    /** The controller cannot be asked: the arm is stopped, and the stream stands still until it can. */
    private void blind(RuntimeException e) {
        locked = true;
        state = null;
        if (!trouble.equals(String.valueOf(e))) {
            trouble = String.valueOf(e);
            log.info("the controller does not answer: " + trouble);
        }
        Running motion = running;
        if (motion != null) {
            try {
                motion.end("safety", "the controller does not answer: " + trouble);
            } catch (RuntimeException again) {
                log.info("and cannot be stopped: " + again);
            }
        }
    }

    // --- requests ---------------------------------------------------------------------------------------------

    private Map<String, Object> carryOut(Request request) throws RefusedException {
        String verb = request.verb;
        if ("permit".equals(verb)) {
            String by = request.text("by");
            refuseInStop();
            locked = false;
            log.info(by + " permits motion");
            return new LinkedHashMap<String, Object>();
        }
        if ("tool".equals(verb)) {
            return attach(new Load(request.number("mass_kg"), request.numbers("centre_m", 3),
                    request.numbers("tcp_xyz_m", 3), request.numbers("tcp_abc_rad", 3)));
        }
        if ("move".equals(verb)) {
            return move(request.numbers("q", Arm.JOINTS), request.positive("speed_rad_s"),
                    request.positive("acceleration_rad_s2"));
        }
        if ("stop".equals(verb)) {
            Running motion = running;
            if (motion != null) {
                motion.end("stopped", "the motion was stopped");
            }
            return new LinkedHashMap<String, Object>();
        }
        if ("fri".equals(verb)) {
            monitor(request.text("host"), request.whole("port", 1, 65535), request.whole("period_ms", 0, 100));
            return new LinkedHashMap<String, Object>();
        }
        throw new RefusedException("unknown", "there is no request " + verb);
    }

    private Map<String, Object> attach(Load load) throws RefusedException {
        if (load.massKg < 0.0 || load.massKg > arm.ratedLoadKg()) {
            throw new RefusedException("load",
                    "a load of " + load.massKg + " kg is not within 0 to " + arm.ratedLoadKg() + " kg");
        }
        if (running != null) {
            throw new RefusedException("moving", "the arm moves");
        }
        Load inForce = arm.attach(load);
        return Json.object("mass_kg", Double.valueOf(inForce.massKg), "centre_m", Json.list(inForce.centreM),
                "tcp_xyz_m", Json.list(inForce.tcpXyzM), "tcp_abc_rad", Json.list(inForce.tcpAbcRad));
    }

    private Map<String, Object> move(double[] goalRad, double speedRadS, double accelerationRadS2)
            throws RefusedException {
        refuseInStop();
        if (locked) {
            throw new RefusedException("locked", "nobody has permitted motion");
        }
        if (running != null) {
            throw new RefusedException("moving", "the arm moves already");
        }
        double[] lower = arm.lowerLimitsRad();
        double[] upper = arm.upperLimitsRad();
        for (int i = 0; i < goalRad.length; i++) {
            if (goalRad[i] < lower[i] || goalRad[i] > upper[i]) {
                throw new RefusedException("limits", "joint " + (i + 1) + " would leave its range");
            }
        }
        if (!state.ready) {
            throw new RefusedException("not_ready", "the controller says that the arm is not ready to move");
        }
        motions++;
        running = new Running(motions, arm.move(goalRad, speedRadS, accelerationRadS2), goalRad);
        return Json.object("motion", Long.valueOf(motions));
    }

    private void monitor(String host, int port, int periodMs) throws RefusedException {
        if (fri == null) {
            throw new RefusedException("not_ready", "start OrthocaptureFriServer: this application has no FRI");
        }
        fri.end();
        if (periodMs > 0) {
            fri.start(host, port, periodMs);
        }
    }

    private void refuseInStop() throws RefusedException {
        if (state == null) {
            throw new RefusedException("not_ready", "the controller does not answer: " + trouble);
        }
        if (!ArmState.NORMAL.equals(state.safety)) {
            throw new RefusedException("safety", "the arm is in " + state.safety.replace('_', ' '));
        }
    }

    private Map<String, Object> stateLine(Running motion, long nowNs) {
        lines++;
        return Json.object(
                "is", "state", "n", Long.valueOf(lines), "time_s", Double.valueOf(timeS(nowNs)),
                "q", Json.list(state.jointsRad), "q_command", Json.list(state.commandedRad),
                "flange_xyz_m", Json.list(state.flangeXyzM), "flange_abc_rad", Json.list(state.flangeAbcRad),
                "mode", state.mode, "safety", state.safety, "ready", Boolean.valueOf(state.ready),
                "locked", Boolean.valueOf(locked), "motion", Long.valueOf(motion == null ? 0 : motion.number),
                "override", Double.valueOf(state.override));
    }

    private double timeS(long nowNs) {
        return (nowNs - startNs) / 1e9;
    }
}
