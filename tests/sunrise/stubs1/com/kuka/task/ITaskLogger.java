// A signature of KUKA's API, for the compiler alone.
package com.kuka.task;

public interface ITaskLogger {
    void info(String text);
}
