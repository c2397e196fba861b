// A signature of KUKA's API, for the compiler alone.
package com.kuka.roboticsAPI.controllerModel.sunrise;

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
