// A signature of KUKA's API, for the compiler alone.
package com.kuka.device.common;

public interface JointLimits {
    JointPosition getMinJointPosition();

    JointPosition getMaxJointPosition();
}
