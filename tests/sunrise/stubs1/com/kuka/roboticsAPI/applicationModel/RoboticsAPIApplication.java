// A signature of KUKA's API, for the compiler alone.
package com.kuka.roboticsAPI.applicationModel;

import com.kuka.task.ITaskLogger;

public abstract class RoboticsAPIApplication {
    public abstract void run() throws Exception;

    public void dispose() {
        throw new UnsupportedOperationException();
    }

    public ITaskLogger getLogger() {
        throw new UnsupportedOperationException();
    }

    public IApplicationControl getApplicationControl() {
        throw new UnsupportedOperationException();
    }
}
