"""KUKA's Fast Robot Interface as a monitor that only listens: its wire, a process that answers it, and the poses."""
