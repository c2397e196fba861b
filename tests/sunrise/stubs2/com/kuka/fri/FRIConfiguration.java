// A signature of KUKA's API, for the compiler alone.
package com.kuka.fri;

import com.kuka.med.devicemodel.LBRMed;

public abstract class FRIConfiguration {
    public static FRIConfiguration createRemoteConfiguration(LBRMed device, String host) {
        throw new UnsupportedOperationException();
    }

    public abstract void setPortOnRemote(int port);

    public abstract void setSendPeriodMilliSec(int period);
}
