"""What stands in for hardware, so that the code for a real station can be tried: servers that answer as the devices do."""
