"""The app in the browser: a folder for any static host."""

from torchface.workflows.browser_app.export_app import AppReport, export_app

__all__ = ["AppReport", "export_app"]
