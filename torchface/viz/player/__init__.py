"""A face that plays in a report: drawn by the browser from files beside the page, without a server or a network."""

from torchface.viz.player.writing import Markers, Panel, Played, Player, write_player

__all__ = ["Markers", "Panel", "Played", "Player", "write_player"]
