"""Run the application: command line, demo, report and benchmark."""
