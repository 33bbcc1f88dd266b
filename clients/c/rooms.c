/* A planner's choice in C: reads one message of `roomcast/v1/room-scores`, byte for byte as it lies in shared memory, from a file, and
 * names the room where the robot disturbs least. */
#include <stdio.h>
#include <string.h>

#include "roomcast.h"

int main(int argc, char **argv) {
    RoomcastRoomScoresV1 scores;
    FILE *file = argc == 2 ? fopen(argv[1], "rb") : NULL;
    if (file == NULL) {
        fprintf(stderr, "usage: rooms FILE\n");
        return 2;
    }
    size_t bytes = fread(&scores, 1, sizeof scores, file);
    int more = fgetc(file) != EOF;
    fclose(file);
    /* What comes from another process is checked before it is believed. */
    if (bytes != sizeof scores || more || scores.room_count == 0 || scores.room_count > ROOMCAST_MAX_ROOMS) {
        fprintf(stderr, "rooms: this is no %s\n", ROOMCAST_TYPE_NAME_ROOMSCORESV1);
        return 1;
    }
    const RoomcastRoomV1 *calmest = &scores.room[0];
    for (uint32_t index = 1; index < scores.room_count; index++) {
        if (scores.room[index].probability < calmest->probability) {
            calmest = &scores.room[index];
        }
    }
    printf("scores %llu: go to %.*s (next with %.3f)\n", (unsigned long long)scores.sequence, ROOMCAST_NAME_BYTES,
           (const char *)calmest->id, calmest->probability);
    return 0;
}
