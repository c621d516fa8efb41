from .store.records import Round as Round
from .store.repository import Store as Store
from .store.repository import open_store as open_store
