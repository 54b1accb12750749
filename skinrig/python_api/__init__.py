"""Run skinrig from Python and notebooks: functions, and results that notebooks display."""
