"""slrig.service under a systemd of its own, in a container that sees this machine's files and changes none."""
