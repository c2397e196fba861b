// The application for Sunrise.OS Med 2.x and LBR Med: start it on the smartPAD.
package orthocapture.sunrise.v2;

import com.kuka.med.devicemodel.LBRMed;
import com.kuka.roboticsAPI.applicationModel.IApplicationControl;
import com.kuka.roboticsAPI.applicationModel.RoboticsAPIApplication;
import javax.inject.Inject;
import orthocapture.sunrise.Fri;
import orthocapture.sunrise.Log;
import orthocapture.sunrise.Server;

public class OrthocaptureServer extends RoboticsAPIApplication {
    @Inject
    private LBRMed lbr;

    @Inject
    private IApplicationControl control;

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
        server = new Server(new LbrArm(lbr, control), fri, null, Server.PORT, log);
        server.run();
    }

    @Override
    public void dispose() throws Exception {
        if (server != null) {
            server.stop();
        }
        if (fri != null) {
            fri.end();
        }
        super.dispose();
    }

    /** FRI where it is installed; null without. */
    protected Fri fri(LBRMed arm, Log log) {
        return null;
    }
}
