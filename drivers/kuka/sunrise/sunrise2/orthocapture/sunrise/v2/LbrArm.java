// The arm of Sunrise.OS Med 2.x: every call to KUKA's API is in this file. Lengths there are millimetres.
package orthocapture.sunrise.v2;

import static com.kuka.roboticsAPI.motionModel.BasicMotions.ptp;

import com.kuka.device.common.JointPosition;
import com.kuka.geometry.LoadData;
import com.kuka.geometry.Tool;
import com.kuka.math.geometry.ITransformation;
import com.kuka.med.devicemodel.LBRMed;
import com.kuka.motion.IMotionContainer;
import com.kuka.roboticsAPI.applicationModel.IApplicationControl;
import com.kuka.roboticsAPI.motionModel.ErrorHandlingAction;
import com.kuka.roboticsAPI.motionModel.IMotionErrorHandler;
import java.util.List;
import orthocapture.sunrise.Arm;
import orthocapture.sunrise.ArmState;
import orthocapture.sunrise.Lbr14;
import orthocapture.sunrise.Load;
import orthocapture.sunrise.Motion;
import orthocapture.sunrise.RefusedException;

final class LbrArm implements Arm, IMotionErrorHandler {
    private static final double MM = 1000.0;

    private final LBRMed lbr;
    private final IApplicationControl control;
    private volatile Moving moving;
    private Tool tool;

    LbrArm(LBRMed lbr, IApplicationControl control) {
        this.lbr = lbr;
        this.control = control;
        control.registerMotionErrorHandler(this);
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
        return "Sunrise.OS Med 2";
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
        // The types of these answers are not named, because their packages differ between versions.
        String mode = String.valueOf(lbr.getSafetyState().getOperationMode());
        String[] emergencyStops = {
            String.valueOf(lbr.getSafetyState().getEmergencyStopInt()),
            String.valueOf(lbr.getSafetyState().getEmergencyStopEx()),
        };
        ITransformation flange = lbr.getCurrentCartesianPosition(lbr.getFlange()).getTransformationFromParent();
        return new ArmState(
                joints(lbr.getCurrentJointPosition()), joints(lbr.getCommandedJointPosition()),
                new double[] {flange.getX() / MM, flange.getY() / MM, flange.getZ() / MM},
                new double[] {flange.getAlphaRad(), flange.getBetaRad(), flange.getGammaRad()},
                mode,
                Lbr14.safety(String.valueOf(lbr.getSafetyState().getSafetyStopSignal()), emergencyStops,
                        String.valueOf(lbr.getSafetyState().getOperatorSafetyState()), mode,
                        String.valueOf(lbr.getSafetyState().getEnablingDeviceState())),
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
    public ErrorHandlingAction handleExecutionError(IMotionContainer failed, List<IMotionContainer> cancelled) {
        return tell(failed.getErrorMessage());
    }

    /** Called by the controller when the arm cannot be held where it is. */
    @Override
    public ErrorHandlingAction handleMaintainingError(IMotionContainer last, List<IMotionContainer> cancelled,
                                                      String message) {
        return tell(message);
    }

    private ErrorHandlingAction tell(String message) {
        Moving last = moving;
        if (last != null) {
            last.failure = String.valueOf(message);
        }
        return ErrorHandlingAction.IGNORE;  // the client is told, and nothing waits for Start on the smartPAD
    }

    private static double[] joints(JointPosition position) {
        return position.toArray();
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
