// A signature of KUKA's API, for the compiler alone.
package com.kuka.roboticsAPI.applicationModel;

import com.kuka.roboticsAPI.motionModel.IErrorHandler;

public interface IApplicationControl {
    double getApplicationOverride();

    void registerMoveAsyncErrorHandler(IErrorHandler handler);
}
