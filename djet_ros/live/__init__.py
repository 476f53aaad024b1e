"""The live nodes without their middleware: sessions, image queue, topics, QoS."""
