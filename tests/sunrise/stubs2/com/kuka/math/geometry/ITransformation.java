// A signature of KUKA's API, for the compiler alone.
package com.kuka.math.geometry;

public interface ITransformation {
    double getX();

    double getY();

    double getZ();

    double getAlphaRad();

    double getBetaRad();

    double getGammaRad();
}
