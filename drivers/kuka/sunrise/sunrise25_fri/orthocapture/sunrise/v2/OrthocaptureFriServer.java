// The same application with FRI 2.5 as a monitor; needs the package Fast Robot Interface in the station setup.
package orthocapture.sunrise.v2;

import com.kuka.fri.FRIConfiguration;
import com.kuka.fri.FRISession;
import com.kuka.med.devicemodel.LBRMed;
import orthocapture.sunrise.Fri;
import orthocapture.sunrise.Log;

public final class OrthocaptureFriServer extends OrthocaptureServer {
    @Override
    protected Fri fri(final LBRMed arm, final Log log) {
        return new Fri() {
            private FRISession session;

            @Override
            public void start(String host, int port, int periodMs) {
                FRIConfiguration configuration = FRIConfiguration.createRemoteConfiguration(arm, host);
                configuration.setPortOnRemote(port);
                configuration.setSendPeriodMilliSec(periodMs);
                session = new FRISession(configuration);  // without an overlay it never commands
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
