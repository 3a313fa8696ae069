"""What there is to look at, as HTML files that open offline: reports and recordings."""
