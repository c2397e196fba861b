// A signature of KUKA's API, for the compiler alone.
package com.kuka.motion;

public interface IMotion {
}
