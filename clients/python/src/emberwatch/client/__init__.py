"""Clients of a running server or of worlds in this process, observers, and recordings."""

from emberwatch.client import observer as observer
from emberwatch.client import replies as replies
from emberwatch.client import wire as wire
from emberwatch.client.client import Client as Client
from emberwatch.client.client import Lease as Lease
from emberwatch.client.client import connect as connect
from emberwatch.client.client import embed as embed
from emberwatch.client.observer import Observer as Observer
from emberwatch.client.observer import observe as observe
