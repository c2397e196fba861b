// A signature for the compiler alone; its package is not known, and the application does not name it.
package com.kuka.safety;

public final class SunriseSafetyState {
    private SunriseSafetyState() {
    }

    public enum SafetyStopType {
        NOSTOP, STOP0, STOP1
    }

    public enum EmergencyStop {
        ACTIVE, INACTIVE
    }

    public enum OperatorSafety {
        OPERATOR_SAFETY_OPEN, OPERATOR_SAFETY_CLOSED
    }

    public enum EnablingDeviceState {
        NONE, NORMAL, HANDGUIDING
    }
}
