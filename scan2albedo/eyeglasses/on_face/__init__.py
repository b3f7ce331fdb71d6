"""A frame registered on a face from key points and masks in calibrated views (S3)."""
