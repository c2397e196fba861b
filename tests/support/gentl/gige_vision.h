/* The GigE Vision side of the GenTL producer: the camera's registers, and its images in buffers. */
#include <arpa/inet.h>
#include <pthread.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

typedef int32_t GC_ERROR;
typedef void *Handle;
enum {
    GOOD = 0, NOT_IMPLEMENTED = -1003, ACCESS_DENIED = -1005, INVALID_ID = -1007, NO_DATA = -1008,
    INVALID_PARAMETER = -1009, IO = -1010, TIMEOUT = -1011, NOT_AVAILABLE = -1014, TOO_SMALL = -1016,
    INVALID_INDEX = -1017
};
enum { MOST_BUFFERS = 32 };
enum { ANNOUNCED, QUEUED, FILLED };

typedef struct {
    char *base;
    void *user;
    size_t size, filled;
    uint64_t number, timestamp;
    uint32_t width, height, format;
    int state, incomplete;
} Buffer;

extern struct sockaddr_in camera;
extern int control, stream; /* sockets; -1: none */
extern int is_there, controls, is_acquiring, n_buffers, n_ready;
extern uint64_t delivered;
extern Buffer buffers[MOST_BUFFERS], *ready[MOST_BUFFERS];
extern pthread_mutex_t buffers_lock;
extern pthread_cond_t filled; /* a buffer became ready */

void wait_at_most(int at, int ms);
int ask(uint16_t command, const void *data, size_t length, char *answer, size_t room);
GC_ERROR read_memory(uint64_t from, char *to, size_t length);
GC_ERROR write_memory(uint64_t to, const char *from, size_t length);
GC_ERROR write_word(uint32_t to, uint32_t value);
void *beat(void *nothing);    /* a thread: keeps control of the camera */
void *receive(void *nothing); /* a thread: fills buffers */
