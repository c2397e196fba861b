// A signature of KUKA's API, for the compiler alone.
package com.kuka.roboticsAPI.motionModel;

public abstract class PTP {
    public abstract PTP setJointVelocityRel(double ratio);

    public abstract PTP setJointAccelerationRel(double ratio);
}
