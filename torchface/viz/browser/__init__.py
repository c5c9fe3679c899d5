"""Rig viewer and picker in the browser, served by viser on 127.0.0.1 (extra ``viewer``)."""
