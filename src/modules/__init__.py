"""Networks and their training. This package uses torch and does not depend on the robot."""
