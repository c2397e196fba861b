// A signature of KUKA's API, for the compiler alone.
package com.kuka.med.devicemodel;

import com.kuka.device.common.JointLimits;
import com.kuka.device.common.JointPosition;
import com.kuka.geometry.Frame;
import com.kuka.geometry.ObjectFrame;
import com.kuka.motion.IMotion;
import com.kuka.motion.IMotionContainer;
import com.kuka.safety.ISafetyState;

public interface LBRMed {
    String getName();

    JointPosition getCurrentJointPosition();

    JointPosition getCommandedJointPosition();

    Frame getCurrentCartesianPosition(ObjectFrame frame);

    ObjectFrame getFlange();

    JointLimits getJointLimits();

    ISafetyState getSafetyState();

    boolean isMastered();

    boolean isReadyToMove();

    IMotionContainer moveAsync(IMotion motion);

    <T> T getCapability(Class<T> capability);
}
