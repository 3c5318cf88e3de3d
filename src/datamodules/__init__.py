"""Where robot and network meet: labels, collected data, replay, and the loop of trial and error."""
