"""ROS 2 without an installation of ROS: a bridge to rmw_zenoh, and our messages as a package."""
