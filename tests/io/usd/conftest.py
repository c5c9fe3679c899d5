from reading_here import same_process

__all__ = ["same_process"]
