"""What several test folders share. Import it: ``from support.waiting import wait_until``."""
