// Where the engine writes what a person at the smartPAD should be able to read.
package orthocapture.sunrise;

public interface Log {
    void info(String text);
}
