// A signature for the compiler alone; its package is not known, and the application does not name it.
package com.kuka.safety;

public interface ISafetyState {
    OperationMode getOperationMode();

    SunriseSafetyState.SafetyStopType getSafetyStopSignal();

    SunriseSafetyState.EmergencyStop getEmergencyStopInt();

    SunriseSafetyState.EmergencyStop getEmergencyStopEx();

    SunriseSafetyState.OperatorSafety getOperatorSafetyState();

    SunriseSafetyState.EnablingDeviceState getEnablingDeviceState();
}
