"""nuScenes: tables of JSON beside the files of its sensors, read and written without its own toolkit."""
