// The same application with FRI as a monitor; needs the package Fast Robot Interface in the station setup.
package orthocapture.sunrise.v1;

import com.kuka.connectivity.fastRobotInterface.FRIConfiguration;
import com.kuka.connectivity.fastRobotInterface.FRISession;
import com.kuka.roboticsAPI.deviceModel.LBR;
import orthocapture.sunrise.Fri;
import orthocapture.sunrise.Log;

public final class OrthocaptureFriServer extends OrthocaptureServer {
    @Override
    protected Fri fri(final LBR arm, final Log log) {
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
