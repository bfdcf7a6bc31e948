"""Types of the fixtures in conftest.py that tests call."""

from collections.abc import Callable

from playwright.sync_api import Page

NewExperiment = Callable[..., str]
SignIn = Callable[..., Page]
