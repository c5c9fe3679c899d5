"""The app in the browser: a folder for any static host."""

from torchface.workflows.browser_app.app_folder import AppReport, export_app

__all__ = ["AppReport", "export_app"]
