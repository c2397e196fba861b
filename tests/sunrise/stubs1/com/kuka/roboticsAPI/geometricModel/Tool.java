// A signature of KUKA's API, for the compiler alone.
package com.kuka.roboticsAPI.geometricModel;

public class Tool {
    public Tool(String name, LoadData load) {
        throw new UnsupportedOperationException();
    }

    public LoadData getLoadData() {
        throw new UnsupportedOperationException();
    }

    public void attachTo(ObjectFrame frame) {
        throw new UnsupportedOperationException();
    }

    public void detach() {
        throw new UnsupportedOperationException();
    }
}
