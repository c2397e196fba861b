// A signature of KUKA's API, for the compiler alone.
package com.kuka.geometry;

public interface ObjectFrame {
}
