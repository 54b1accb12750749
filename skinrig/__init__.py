"""The application: command line, demo, report and benchmark."""
