// A signature of KUKA's API, for the compiler alone.
package com.kuka.roboticsAPI.motionModel;

import com.kuka.device.common.JointPosition;

public final class BasicMotions {
    private BasicMotions() {
    }

    public static PTP ptp(JointPosition goal) {
        throw new UnsupportedOperationException();
    }
}
