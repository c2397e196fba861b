// A signature of KUKA's API, for the compiler alone.
package com.kuka.roboticsAPI.deviceModel;

public class JointPosition {
    public JointPosition(double... joints) {
        throw new UnsupportedOperationException();
    }

    public double get(int joint) {
        throw new UnsupportedOperationException();
    }
}
