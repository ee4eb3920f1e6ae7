"""Episodes on worlds: a session plays them, a recorder keeps them."""
