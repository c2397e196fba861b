// The arm of Sunrise.OS 1.x: every call to KUKA's API is in this file. Lengths there are millimetres.
package orthocapture.sunrise.v1;

import static com.kuka.roboticsAPI.motionModel.BasicMotions.ptp;

import com.kuka.roboticsAPI.applicationModel.IApplicationControl;
import com.kuka.roboticsAPI.controllerModel.sunrise.ISafetyState;
import com.kuka.roboticsAPI.deviceModel.Device;
import com.kuka.roboticsAPI.deviceModel.JointPosition;
import com.kuka.roboticsAPI.deviceModel.LBR;
import com.kuka.roboticsAPI.geometricModel.Frame;
import com.kuka.roboticsAPI.geometricModel.LoadData;
import com.kuka.roboticsAPI.geometricModel.Tool;
import com.kuka.roboticsAPI.motionModel.ErrorHandlingAction;
import com.kuka.roboticsAPI.motionModel.IErrorHandler;
import com.kuka.roboticsAPI.motionModel.IMotionContainer;
import java.util.List;
import orthocapture.sunrise.Arm;
import orthocapture.sunrise.ArmState;
import orthocapture.sunrise.Lbr14;
import orthocapture.sunrise.Load;
import orthocapture.sunrise.Motion;
import orthocapture.sunrise.RefusedException;

final class LbrArm implements Arm, IErrorHandler {
    private static final double MM = 1000.0;

    private final LBR lbr;
    private final IApplicationControl control;
    private volatile Moving moving;
    private Tool tool;

    LbrArm(LBR lbr, IApplicationControl control) {
        this.lbr = lbr;
        this.control = control;
        control.registerMoveAsyncErrorHandler(this);
    }

    @Override
    public String model() {
        return Lbr14.model(lbr.getName());
    }

    @Override
    public String serial() {
        return lbr.getName();
    }

    @Override
    public String software() {
        return "Sunrise.OS 1";
    }

    @Override
    public double[] upperLimitsRad() {
        return joints(lbr.getJointLimits().getMaxJointPosition());
    }

    @Override
    public double[] lowerLimitsRad() {
        return joints(lbr.getJointLimits().getMinJointPosition());
    }

    @Override
    public double ratedLoadKg() {
        return Lbr14.RATED_LOAD_KG;
    }

    @Override
    public ArmState read() {
        ISafetyState safety = lbr.getSafetyState();
        String mode = String.valueOf(safety.getOperationMode());
        String[] emergencyStops = {
            String.valueOf(safety.getEmergencyStopInt()), String.valueOf(safety.getEmergencyStopEx()),
        };
        Frame flange = lbr.getCurrentCartesianPosition(lbr.getFlange(), lbr.getRootFrame());
        return new ArmState(
                joints(lbr.getCurrentJointPosition()), joints(lbr.getCommandedJointPosition()),
                new double[] {flange.getX() / MM, flange.getY() / MM, flange.getZ() / MM},
                new double[] {flange.getAlphaRad(), flange.getBetaRad(), flange.getGammaRad()},
                mode,
                Lbr14.safety(String.valueOf(safety.getSafetyStopSignal()), emergencyStops,
                        String.valueOf(safety.getOperatorSafetyState()), mode,
                        String.valueOf(safety.getEnablingDeviceState())),
                lbr.isMastered() && lbr.isReadyToMove(), control.getApplicationOverride());
    }

    @Override
    public Load attach(Load load) {
        if (tool != null) {
            tool.detach();
        }
        LoadData data = new LoadData();
        data.setMass(load.massKg);
        data.setCenterOfMass(load.centreM[0] * MM, load.centreM[1] * MM, load.centreM[2] * MM);
        tool = new Tool("orthocapture", data);
        tool.attachTo(lbr.getFlange());
        return new Load(tool.getLoadData().getMass(), load.centreM, load.tcpXyzM, load.tcpAbcRad);
    }

    @Override
    public Motion move(double[] goalRad, double speedRadS, double accelerationRadS2) throws RefusedException {
        double speed = Lbr14.speedRatio(joints(lbr.getCommandedJointPosition()), goalRad, speedRadS);
        try {
            moving = new Moving();
            moving.container = lbr.moveAsync(ptp(new JointPosition(goalRad)).setJointVelocityRel(speed)
                    .setJointAccelerationRel(Lbr14.accelerationRatio(accelerationRadS2)));
            return moving;
        } catch (RuntimeException e) {
            throw new RefusedException("failed", String.valueOf(e.getMessage()));
        }
    }

    /** Called by the controller when a motion cannot be carried out. */
    @Override
    public ErrorHandlingAction handleError(Device device, IMotionContainer failed, List<IMotionContainer> cancelled) {
        Moving last = moving;
        if (last != null) {
            last.failure = String.valueOf(failed.getErrorMessage());
        }
        return ErrorHandlingAction.Ignore;  // the client is told, and nothing waits for Start on the smartPAD
    }

    private static double[] joints(JointPosition position) {
        double[] joints = new double[JOINTS];
        for (int i = 0; i < JOINTS; i++) {
            joints[i] = position.get(i);
        }
        return joints;
    }

    private static final class Moving implements Motion {
        private volatile IMotionContainer container;
        private volatile String failure = "";

        @Override
        public void cancel() {
            container.cancel();
        }

        @Override
        public boolean isOver() {
            return container.isFinished();
        }

        @Override
        public String failure() {
            return failure;
        }
    }
}
