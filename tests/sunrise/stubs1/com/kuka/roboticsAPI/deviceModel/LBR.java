// A signature of KUKA's API, for the compiler alone.
package com.kuka.roboticsAPI.deviceModel;

import com.kuka.roboticsAPI.controllerModel.sunrise.ISafetyState;
import com.kuka.roboticsAPI.geometricModel.AbstractFrame;
import com.kuka.roboticsAPI.geometricModel.Frame;
import com.kuka.roboticsAPI.geometricModel.ObjectFrame;
import com.kuka.roboticsAPI.motionModel.IMotionContainer;
import com.kuka.roboticsAPI.motionModel.PTP;

public interface LBR extends Device {
    JointPosition getCurrentJointPosition();

    JointPosition getCommandedJointPosition();

    Frame getCurrentCartesianPosition(ObjectFrame frame, AbstractFrame reference);

    ObjectFrame getFlange();

    ObjectFrame getRootFrame();

    JointLimits getJointLimits();

    ISafetyState getSafetyState();

    boolean isMastered();

    boolean isReadyToMove();

    IMotionContainer moveAsync(PTP motion);
}
