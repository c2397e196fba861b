// A signature of KUKA's API, for the compiler alone.
package com.kuka.fri.api.monitoring;

import com.kuka.med.devicemodel.LBRMed;

public interface IFriMonitoring {
    IFriConfiguration createFriConfiguration(LBRMed arm, String host);

    IFriSession createFriSession(IFriConfiguration configuration);
}
