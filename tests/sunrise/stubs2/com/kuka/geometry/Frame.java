// A signature of KUKA's API, for the compiler alone.
package com.kuka.geometry;

import com.kuka.math.geometry.ITransformation;

public interface Frame {
    ITransformation getTransformationFromParent();
}
