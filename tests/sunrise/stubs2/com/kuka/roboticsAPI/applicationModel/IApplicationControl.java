// A signature of KUKA's API, for the compiler alone.
package com.kuka.roboticsAPI.applicationModel;

import com.kuka.roboticsAPI.motionModel.IMotionErrorHandler;

public interface IApplicationControl {
    double getApplicationOverride();

    void registerMotionErrorHandler(IMotionErrorHandler handler);
}
