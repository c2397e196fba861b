// A signature of KUKA's API, for the compiler alone.
package com.kuka.fri.api.monitoring;

public interface IFriSession {
    void close();
}
