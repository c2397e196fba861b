"""The wires of a case: byte streams, their messages, and the proxy that spoils one of them."""
