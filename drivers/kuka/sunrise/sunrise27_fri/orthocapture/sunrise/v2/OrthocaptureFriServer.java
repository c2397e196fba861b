// The same application with FRI 2.7 as a monitor; needs the package Fast Robot Interface in the station setup.
package orthocapture.sunrise.v2;

import com.kuka.fri.api.monitoring.IFriConfiguration;
import com.kuka.fri.api.monitoring.IFriMonitoring;
import com.kuka.fri.api.monitoring.IFriSession;
import com.kuka.med.devicemodel.LBRMed;
import orthocapture.sunrise.Fri;
import orthocapture.sunrise.Log;
import orthocapture.sunrise.RefusedException;

public final class OrthocaptureFriServer extends OrthocaptureServer {
    private static final int PORT = 30200;  // of FRI where nothing else is set

    @Override
    protected Fri fri(final LBRMed arm, final Log log) {
        return new Fri() {
            private IFriSession session;

            @Override
            public void start(String host, int port, int periodMs) throws RefusedException {
                if (port != PORT) {
                    throw new RefusedException("not_ready", "FRI 2.7 sends to port " + PORT + " here, not to " + port);
                }
                IFriMonitoring monitoring = arm.getCapability(IFriMonitoring.class);
                IFriConfiguration configuration = monitoring.createFriConfiguration(arm, host);
                configuration.setSendPeriodMilliSec(periodMs);
                session = monitoring.createFriSession(configuration);  // without an overlay it never commands
                log.info("FRI monitors to " + host + ":" + port + " every " + periodMs + " ms");
            }

            @Override
            public void end() {
                if (session != null) {
                    session.close();
                    session = null;
                }
            }
        };
    }
}
