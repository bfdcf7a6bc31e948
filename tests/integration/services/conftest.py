from support.store_fixtures import postgres_server, sqlite, stores

__all__ = ["postgres_server", "sqlite", "stores"]
