// What hangs on the flange, in metres, radians and kilograms: its mass and centre, and the tool centre point.
package orthocapture.sunrise;

public final class Load {
    public final double massKg;
    public final double[] centreM;
    public final double[] tcpXyzM;
    public final double[] tcpAbcRad;

    public Load(double massKg, double[] centreM, double[] tcpXyzM, double[] tcpAbcRad) {
        this.massKg = massKg;
        this.centreM = centreM;
        this.tcpXyzM = tcpXyzM;
        this.tcpAbcRad = tcpAbcRad;
    }
}
