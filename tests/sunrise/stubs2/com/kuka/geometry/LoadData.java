// A signature of KUKA's API, for the compiler alone.
package com.kuka.geometry;

public class LoadData {
    public void setMass(double kilograms) {
        throw new UnsupportedOperationException();
    }

    public double getMass() {
        throw new UnsupportedOperationException();
    }

    public void setCenterOfMass(double x, double y, double z) {
        throw new UnsupportedOperationException();
    }
}
