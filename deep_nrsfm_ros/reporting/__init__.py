"""HTML pages that open offline: reports of trainings, and recordings."""
