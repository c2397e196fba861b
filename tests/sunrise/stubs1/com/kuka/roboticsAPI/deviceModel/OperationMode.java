// A signature of KUKA's API, for the compiler alone.
package com.kuka.roboticsAPI.deviceModel;

public enum OperationMode {
    T1, T2, AUT
}
