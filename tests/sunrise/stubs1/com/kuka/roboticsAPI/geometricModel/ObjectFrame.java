// A signature of KUKA's API, for the compiler alone.
package com.kuka.roboticsAPI.geometricModel;

public interface ObjectFrame extends AbstractFrame {
}
