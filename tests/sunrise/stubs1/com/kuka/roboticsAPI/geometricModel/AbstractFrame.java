// A signature of KUKA's API, for the compiler alone.
package com.kuka.roboticsAPI.geometricModel;

public interface AbstractFrame {
    double getX();

    double getY();

    double getZ();

    double getAlphaRad();

    double getBetaRad();

    double getGammaRad();
}
