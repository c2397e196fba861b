// The application for Sunrise.OS 1.x and LBR iiwa: start it on the smartPAD.
package orthocapture.sunrise.v1;

import com.kuka.roboticsAPI.applicationModel.RoboticsAPIApplication;
import com.kuka.roboticsAPI.deviceModel.LBR;
import javax.inject.Inject;
import orthocapture.sunrise.Fri;
import orthocapture.sunrise.Log;
import orthocapture.sunrise.Server;

public class OrthocaptureServer extends RoboticsAPIApplication {
    @Inject
    private LBR lbr;

    private Server server;
    private Fri fri;

    @Override
    public void run() throws Exception {
        Log log = new Log() {
            @Override
            public void info(String text) {
                getLogger().info(text);
            }
        };
        fri = fri(lbr, log);
        server = new Server(new LbrArm(lbr, getApplicationControl()), fri, null, Server.PORT, log);
        server.run();
    }

    @Override
    public void dispose() {
        if (server != null) {
            server.stop();
        }
        if (fri != null) {
            fri.end();
        }
        super.dispose();
    }

    /** FRI where it is installed; null without. */
    protected Fri fri(LBR arm, Log log) {
        return null;
    }
}
