"""Networks and how they learn. torch only: nothing here knows a robot."""
