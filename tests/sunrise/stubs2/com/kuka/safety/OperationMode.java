// A signature for the compiler alone; its package is not known, and the application does not name it.
package com.kuka.safety;

public enum OperationMode {
    T1, T2, AUT
}
