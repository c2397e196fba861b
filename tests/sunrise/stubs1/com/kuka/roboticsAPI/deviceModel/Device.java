// A signature of KUKA's API, for the compiler alone.
package com.kuka.roboticsAPI.deviceModel;

public interface Device {
    String getName();
}
