"""Signing in through an OpenID Connect provider, in a browser. Needs the API and the page, but no workers."""

from pathlib import Path

from playwright.sync_api import Browser, expect

from browser.accessibility import violations_of
from support.api_in_thread import run_api_server
from support.oidc_provider import running_oidc_provider
from support.stores import open_stores


def test_a_person_signs_in_and_out_through_the_provider(browser: Browser, tmp_path: Path) -> None:
    with (
        running_oidc_provider() as provider,
        open_stores(tmp_path) as stores,
        run_api_server(stores, tmp_path, **provider.settings()) as api,
        browser.new_context() as context,
    ):
        page = context.new_page()
        provider.person("ada", name="Ada", error="access_denied")
        page.goto(f"{api.url}/compare/one,two")
        sign_in = page.get_by_role("link", name="Sign in with the lab")
        sign_in.click()
        expect(page.get_by_role("alert")).to_contain_text("The lab did not confirm who you are")
        assert violations_of(page, "sign-in page") == []
        provider.person("ada", name="Ada")
        page.goto(f"{api.url}/compare/one,two")
        sign_in.click()
        expect(page.get_by_title("Signed in as Ada, labeller")).to_be_visible()
        assert page.url == f"{api.url}/compare/one,two"
        page.get_by_role("button", name="Sign out").click()
        expect(page.get_by_role("heading", name="You are signed out")).to_be_visible()
        page.get_by_role("link", name="sign out of the lab").click()
        expect(page.get_by_role("heading", name="Sign in to Accord")).to_be_visible()
        page.goto("about:blank")
