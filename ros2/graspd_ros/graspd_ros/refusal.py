"""Why a request ends without grasps."""


class Refusal(Exception):
    def __init__(self, error: str, message: str) -> None:
        super().__init__(f"{error}: {message}")
        self.error = error
        """NO_IMAGE, INVALID_IMAGE, NO_TRANSFORM, or a status of gRPC."""
        self.message = message
        """What is wrong, with the value, and what to do."""
