"""Camera back ends: GenICam, gphoto2, hot folder and remote cameras."""
