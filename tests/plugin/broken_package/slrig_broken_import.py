"""A plug-in whose module cannot be imported, as after an upgrade that it was not made for."""

message = "built for firmware [2.x], found 3.1"
raise RuntimeError(message)
