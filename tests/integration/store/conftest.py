from support.store_fixtures import postgres_server, s3_server, sqlite, stores

__all__ = ["postgres_server", "s3_server", "sqlite", "stores"]
