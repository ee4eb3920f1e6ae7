"""What people look at: pages, tables, films."""
