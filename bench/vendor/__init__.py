"""The simulators compared, call by call, with what the vendors' clients expect of real devices."""
