"""One class a robot, behind `armd.driver.Driver`."""
