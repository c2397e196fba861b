// A signature of KUKA's API, for the compiler alone.
package com.kuka.roboticsAPI.motionModel;

import com.kuka.motion.IMotionContainer;
import java.util.List;

public interface IMotionErrorHandler {
    ErrorHandlingAction handleExecutionError(IMotionContainer failed, List<IMotionContainer> cancelled);

    ErrorHandlingAction handleMaintainingError(IMotionContainer last, List<IMotionContainer> cancelled, String message);
}
