// A signature of KUKA's API, for the compiler alone.
package com.kuka.connectivity.fastRobotInterface;

import com.kuka.roboticsAPI.deviceModel.Device;

public abstract class FRIConfiguration {
    public static FRIConfiguration createRemoteConfiguration(Device device, String host) {
        throw new UnsupportedOperationException();
    }

    public abstract void setPortOnRemote(int port);

    public abstract void setSendPeriodMilliSec(int period);
}
