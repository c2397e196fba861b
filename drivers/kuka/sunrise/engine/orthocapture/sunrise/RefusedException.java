// A request that is not carried out: its code on the wire, and why.
package orthocapture.sunrise;

public final class RefusedException extends Exception {
    private static final long serialVersionUID = 1L;

    public final String code;

    public RefusedException(String code, String what) {
        super(what);
        this.code = code;
    }
}
