from support.store_fixtures import both, postgres_server, sqlite

__all__ = ["both", "postgres_server", "sqlite"]
