"""What the machine has: devices, cores, memory."""
