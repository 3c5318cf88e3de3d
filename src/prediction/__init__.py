"""From an RGB-D image of one's own to picks."""
