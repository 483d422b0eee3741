"""Files of an installation: systemd units, udev rules, users, first configurations."""
