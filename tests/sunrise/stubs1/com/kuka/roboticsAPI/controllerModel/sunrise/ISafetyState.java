// A signature of KUKA's API, for the compiler alone.
package com.kuka.roboticsAPI.controllerModel.sunrise;

import com.kuka.roboticsAPI.deviceModel.OperationMode;

public interface ISafetyState {
    OperationMode getOperationMode();

    SunriseSafetyState.SafetyStopType getSafetyStopSignal();

    SunriseSafetyState.EmergencyStop getEmergencyStopInt();

    SunriseSafetyState.EmergencyStop getEmergencyStopEx();

    SunriseSafetyState.OperatorSafety getOperatorSafetyState();

    SunriseSafetyState.EnablingDeviceState getEnablingDeviceState();
}
