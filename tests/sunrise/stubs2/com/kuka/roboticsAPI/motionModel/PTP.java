// A signature of KUKA's API, for the compiler alone.
package com.kuka.roboticsAPI.motionModel;

import com.kuka.motion.IMotion;

public abstract class PTP implements IMotion {
    public abstract PTP setJointVelocityRel(double ratio);

    public abstract PTP setJointAccelerationRel(double ratio);
}
