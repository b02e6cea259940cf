"""The axis method: identification of a robot from sweeps of its joints."""
