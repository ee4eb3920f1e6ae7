"""Results for people to look at: pages and tables."""
