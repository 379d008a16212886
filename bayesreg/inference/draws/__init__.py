"""Draws: conversion to ArviZ, convergence diagnostics, moments and functions of draws."""
