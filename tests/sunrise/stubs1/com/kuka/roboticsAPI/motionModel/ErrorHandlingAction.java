// A signature of KUKA's API, for the compiler alone.
package com.kuka.roboticsAPI.motionModel;

public enum ErrorHandlingAction {
    PauseMotion, Ignore
}
