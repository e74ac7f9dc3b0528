"""One Levenberg-Marquardt iteration, the records it keeps and the tests that end a solve."""
