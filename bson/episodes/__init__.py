"""Episodes on worlds: played by a session, kept by a recorder."""
