// A signature of KUKA's API, for the compiler alone.
package com.kuka.device.common;

public class JointPosition {
    public JointPosition(double... joints) {
        throw new UnsupportedOperationException();
    }

    public double[] toArray() {
        throw new UnsupportedOperationException();
    }
}
