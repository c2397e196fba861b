// A signature of KUKA's API, for the compiler alone.
package com.kuka.connectivity.fastRobotInterface;

public class FRISession {
    public FRISession(FRIConfiguration configuration) {
        throw new UnsupportedOperationException();
    }

    public void close() {
        throw new UnsupportedOperationException();
    }
}
