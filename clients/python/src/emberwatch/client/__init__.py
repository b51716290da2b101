"""The client of a server, or of worlds in this process: connect, lease, observe, record."""
