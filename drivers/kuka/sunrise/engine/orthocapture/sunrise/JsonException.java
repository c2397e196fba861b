// A text that is not JSON; the message says where.
package orthocapture.sunrise;

public final class JsonException extends Exception {
    private static final long serialVersionUID = 1L;

    public JsonException(String message) {
        super(message);
    }
}
